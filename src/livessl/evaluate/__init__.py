"""The paper's experiments on our own code: campaigns of simulated rooms, their results, claims and figures."""
