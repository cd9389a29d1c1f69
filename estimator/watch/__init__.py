"""`roadload watch`: what is known at a moment, on the terminal and as a page."""
