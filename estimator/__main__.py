"""`python -m estimator` is the same as `roadload`."""

import sys

from estimator.commands.main import main

sys.exit(main())
