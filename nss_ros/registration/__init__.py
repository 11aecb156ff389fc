"""Pairwise registration: fragments to relative transforms."""
