"""Maps to the controller, all or nothing: the wish, the plan, the session, and what was sent."""
