"""``python -m oodd_eval``: the same as the command ``oodd-eval``."""

import sys

from oodd_eval.cli.main import main

sys.exit(main())
