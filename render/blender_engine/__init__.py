"""Path tracing with Blender's Cycles: a second opinion, in a process of its own that holds the only `bpy`."""
