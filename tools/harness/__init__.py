"""What the checks share: drives and their logs, scores, the command line, figures as data and as tables."""
