"""Scoring: MCAP logs and challenge files to metrics and tables."""
