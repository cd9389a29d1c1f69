"""Importing this hides what only an extra installs: python-can imports asammdf, and so pandas, wherever it finds it."""

import sys

sys.modules["asammdf"] = None
