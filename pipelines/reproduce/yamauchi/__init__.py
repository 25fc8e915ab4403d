"""Experiments of Yamauchi et al., Slip-compensated odometry for tracked vehicle on loose and weak slope."""
