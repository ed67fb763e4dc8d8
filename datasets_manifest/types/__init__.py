"""The types that cross packages or touch the disk: frames, images, records, estimates."""
