"""The learned baselines of the NSS paper: with checkpoints of their authors, or of `nss train`."""
