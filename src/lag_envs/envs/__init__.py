"""Gymnasium's single and vector environments, and the pictures."""
