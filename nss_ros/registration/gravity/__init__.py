"""Registration of levelled fragments by exhaustive search over yaw, x and y."""
