"""A small authority: certificates for a server and its clients, and rules of what each may do."""
