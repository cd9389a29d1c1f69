"""`python -m estimator` is the same as `roadload`."""

import sys

from estimator.cli import main

sys.exit(main())
