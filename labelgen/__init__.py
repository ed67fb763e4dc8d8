"""Labels computed from frames and rendered passes, their validation, and exports."""
