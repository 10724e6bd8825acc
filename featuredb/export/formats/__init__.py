"""What is written for other systems, a module a format."""
