"""The experiments of Tazzari et al., An adaptive observer approach to slip estimation, in simulation."""
