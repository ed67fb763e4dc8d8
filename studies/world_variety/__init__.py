"""Study: how much drogues, tankers and probes differ from scene to scene, as sheets and as numbers."""
