"""Controllers that are not learned: from what a fleet shows to named actions."""
