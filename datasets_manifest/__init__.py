"""The data types that cross rooms or touch disk, and the disk itself. No drawing, no rendering."""
