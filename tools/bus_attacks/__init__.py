"""Attacks on a bus, as changes of recorded traffic, and the estimate under them."""
