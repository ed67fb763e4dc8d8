"""Land and sea below the camera."""
