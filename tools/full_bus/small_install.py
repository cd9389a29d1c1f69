"""Hide asammdf on import: python-can imports it, and pandas with it, wherever this extra is installed."""

import sys

sys.modules["asammdf"] = None  # type: ignore[assignment]  # an import of it fails
