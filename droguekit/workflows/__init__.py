"""What the commands do: the only place where packages are put together."""
