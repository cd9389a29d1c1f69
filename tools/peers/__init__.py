"""Methods of the literature and of other libraries, on the same drives, rows and posteriors."""
