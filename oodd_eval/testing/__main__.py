"""The process that carries out checks of one detector and sends their results, one by one.

Started as ``python -m oodd_eval.testing READ_FD WRITE_FD`` by `oodd_eval.testing.supervise`.
"""

from __future__ import annotations

import faulthandler
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict

from oodd_eval.channel import Channel
from oodd_eval.errors import PluginError
from oodd_eval.plugins import discover
from oodd_eval.testing.bench import Bench, Subject
from oodd_eval.testing.checks import CHECKS, carry_out


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
