"""Synthetic construction sites and the scanner that records them."""
