"""Stands before the real one: a gateway reads no MF4, and python-can imports asammdf wherever it finds it."""

raise ImportError("not installed on a gateway")
