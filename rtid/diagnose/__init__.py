"""Find the physical effect that a model is missing, and how sure that is."""
