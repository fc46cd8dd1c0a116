"""Cost of the checks of a run: of the split, of messages, scores, kept files, and of limits.

``python benchmarks/bench_checks.py [DETECTOR ...]`` (default rf, npn and riqn): runs them on hopper
of split mini, each in a worker process as ``oodd-eval run`` does, and adds up the seconds in which
the harness checks what it reads and receives. What groups apart cost ``bench_isolation.py``
times. Exit code 1 when a check costs more than 5 % of the run.
"""

import sys
import tempfile
import time
from collections import Counter
from functools import wraps

from oodd_eval.cli.main import main as oodd_eval
from oodd_eval.data import bounded, layout, stored
from oodd_eval.plugins import contract, explanations, specs
from oodd_eval.plugins.isolation import child, supervisor
from oodd_eval.results import evaluate
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring import plan

MOST = 0.05
CHECKS = {
    layout: ["content_digest", "check_layout", "check_names"],
    stored: ["check_plain"],
    bounded: ["read_npz"],
    specs: ["check_detector_spec"],
    plan: ["source_digest"],
    supervisor: ["_value", "_number"],
    contract: ["check_scores"],
    explanations: ["checked_explanation"],
    evaluate: ["check_named"],
    child.Child: ["check", "_judge"],
    ResultsDirectory: ["_opened"],
}
seconds = Counter()


def timed(name, function):
    @wraps(function)
    def measured(*arguments, **named):
        start = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            seconds[name] += time.perf_counter() - start

    return measured


def watch():
    """Time every check, by whatever module it was imported."""
    own = [module for name, module in sys.modules.items() if name.startswith("oodd_eval")]
    for place, names in CHECKS.items():
        for name in names:
            function = getattr(place, name)
            for module in (place, *own):
                if vars(module).get(name) is function:
                    setattr(module, name, timed(name, function))


def main(detectors):
    watch()
    with tempfile.TemporaryDirectory() as place:
        command = ["run", "--detector", ",".join(detectors), "--env", "hopper", "--split", "mini"]
        start = time.perf_counter()
        if code := oodd_eval([*command, "--output", f"{place}/results", "--jobs", "1", "-q"]):
            return code
        whole = time.perf_counter() - start
    for name, own in seconds.most_common():
        print(f"{name:20} {own:7.3f} s, {100 * own / whole:.2f} % of {whole:.1f} s")
    print(f"all checks: {100 * seconds.total() / whole:.2f} %, each at most {100 * MOST:.0f} %")
    return int(max(seconds.values()) > MOST * whole)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or ["rf", "npn", "riqn"]))
