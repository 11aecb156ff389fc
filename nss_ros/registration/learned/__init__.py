"""The learned baselines of the NSS paper: networks that load the checkpoints of their authors."""
