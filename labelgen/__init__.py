"""Labels from frames and passes, their validation, and exports."""
