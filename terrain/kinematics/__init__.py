"""From body motion to wheel motion and back."""
