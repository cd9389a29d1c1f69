"""Attacks on a bus, as changes of recorded traffic, and what becomes of the estimate under them."""
