"""Training of the learned baselines on simulated datasets; no method or node imports this."""
