"""A database as a web page on this machine, or as one file that can be sent."""
