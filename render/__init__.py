"""A frame becomes absolute radiance and passes, then what the camera's sensor makes of them."""
