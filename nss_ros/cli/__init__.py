"""The `nss` command line."""
