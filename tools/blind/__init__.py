"""The blind check: draw and seal drives, diagnose their logs, score the answers against the sealed truth."""
