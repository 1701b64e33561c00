"""Applications of esc_gym: training, evaluation and comparison of driving agents."""
