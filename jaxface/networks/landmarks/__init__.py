"""BlazeFace and the face mesh."""
