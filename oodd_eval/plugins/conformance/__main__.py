"""The process that carries out checks of one detector and sends their results, one by one.

Started as ``python -m oodd_eval.plugins.conformance READ_FD WRITE_FD`` by `oodd_eval.plugins.conformance.supervise`.
"""

from __future__ import annotations

import faulthandler
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict

from oodd_eval.errors import PluginError
from oodd_eval.plugins.conformance.bench import Bench, Subject
from oodd_eval.plugins.conformance.checks import CHECKS, carry_out
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.messages import Channel


def main(arguments: Sequence[str]) -> None:
    """Serve one request."""
    reading, writing = (int(a) for a in arguments)
    for descriptor in (reading, writing):
        os.set_inheritable(descriptor, False)
    faulthandler.enable()
    channel = Channel(reading, writing)
    request = channel.receive()
    plugins = discover(only=[request["plugin"]])
    for broken in plugins.broken:
        raise PluginError(f"plug-in {broken.plugin!r} cannot be loaded: {broken.reason}")
    spec = plugins.offer(request["detector"]).spec
    subject = Subject.of(
        spec,
        horizon=request["horizon"],
        seed=request["seed"],
        parameters=request["parameters"],
    )
    bench = Bench(subject)
    for result in carry_out(bench, [CHECKS[name] for name in request["checks"]]):
        channel.send(asdict(result))


main(sys.argv[1:])
