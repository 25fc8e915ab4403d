"""What is driven on which terrain: twists over time, patches by distance travelled."""
