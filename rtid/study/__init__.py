"""One trace under one project: learned from, compared, diagnosed, added to and taken back."""
