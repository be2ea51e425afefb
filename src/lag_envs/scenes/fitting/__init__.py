"""Parameters of a scene from recordings of its motion: `Scene.fit`."""
