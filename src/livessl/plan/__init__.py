"""Where arrays should go: the paper's design rules worked out for a site and told as data, in words and as a figure."""
