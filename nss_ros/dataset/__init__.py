"""Overlap, pairs and the file formats of the NSS dataset and challenge."""
