"""One module for each revision of the tables of outbox and hub."""
