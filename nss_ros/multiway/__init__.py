"""Multi-way registration: relative transforms to poses."""
