"""What a drogue is: dimensions with sources, marker layout and hub, meshes and materials."""
