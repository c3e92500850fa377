"""Migrations of the tables of outbox and hub; their version has a table of its own."""
