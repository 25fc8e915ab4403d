"""The windows of samples as they come: cut, and classified at once or on a thread of their own."""
