"""The figures of campaigns, as PNG: drawn from results and rooms, without statistics of their own."""
