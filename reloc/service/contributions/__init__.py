"""Contributed photos on their way from a query to the database."""
