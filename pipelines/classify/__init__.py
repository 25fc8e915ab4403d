"""``terrain crossval``, ``train`` and ``predict``."""
