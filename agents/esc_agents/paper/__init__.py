"""The paper's experiment: six target policies, ESC against FP and AP."""
