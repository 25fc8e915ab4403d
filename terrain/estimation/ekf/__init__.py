"""The extended Kalman filter: one step for every filter, and what its innovations say of it."""
