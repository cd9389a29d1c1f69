"""Parts of tests/nightly/fuzz.py: spoilt files and spoilt traffic, and what the program makes of them."""
