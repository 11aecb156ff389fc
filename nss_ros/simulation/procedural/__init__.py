"""Construction floors drawn at random, stage by stage."""
