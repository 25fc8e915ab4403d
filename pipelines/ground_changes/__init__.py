"""``terrain find-changes``: changes of the ground, found sample by sample from what wheels answer."""
