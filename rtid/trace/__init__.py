"""Judge a project file against a trace, and a raw capture by itself."""
