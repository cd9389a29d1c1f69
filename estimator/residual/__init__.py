"""Diagnosis of the residual of any model: which columns explain it, where it is, and how far they reduce it."""
