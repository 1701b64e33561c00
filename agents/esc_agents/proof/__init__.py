"""What the product promises, shown: speed, survival, endurance, learning."""
