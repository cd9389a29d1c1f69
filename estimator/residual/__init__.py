"""The diagnosis of any model's residual: which columns explain it, where it is, and how far it shrinks."""
