"""``oodd-eval``, and ``python -m oodd_eval``: the same program."""

import sys


def main() -> int:
    """Carry out this process's command line; an interrupt while it is imported ends it as later."""
    try:
        from oodd_eval.cli.main import main as carry_out  # noqa: PLC0415  takes a second or so

        return carry_out()
    except KeyboardInterrupt:
        sys.stderr.write("oodd-eval: interrupted\n")
        return 2


if __name__ == "__main__":
    sys.exit(main())
