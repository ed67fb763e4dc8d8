"""Path tracing with Blender's Cycles, a second engine; only a process of its own imports `bpy`."""
