"""From a frame to absolute radiance and passes, and from radiance to the images of the camera's sensor."""
