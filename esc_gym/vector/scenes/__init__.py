"""What each scenario family adds to the engine: how a scene begins, what is rewarded, its end."""
