"""The pages: their frame, the scene that draws a flight, the replay of a run, and the page that flies."""
