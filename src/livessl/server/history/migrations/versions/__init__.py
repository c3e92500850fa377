"""One module for each revision of the history's database."""
