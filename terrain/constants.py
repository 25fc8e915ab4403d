"""Physical constants, each with its source."""

GRAVITY_MPS2 = 9.80665  #: Standard gravity (3rd CGPM, 1901)
