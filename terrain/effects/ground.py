"""Effects of the ground, of turning and of side slopes: slip and resistance."""

from __future__ import annotations

from terrain.effects.types import (
    ACCEL,
    BOTH,
    CURRENT,
    EVERY,
    GYRO,
    HEADING,
    MOTION,
    SKIDDING,
    SPEED_X,
    SPEED_Y,
    TRACKED,
    TURNING_CURRENT,
    WITH_IMU,
    Combine,
    Effect,
    Home,
    Parameter,
    PlantPart,
    Wording,
)

SLIP_AND_RESISTANCE: tuple[Effect, ...] = (
    Effect(
        "effective_track",
        (
            Parameter(
                "effective_track_ratio",
                -0.5,
                4.0,
                0.02,
                homes=(Home("", "track_m", Combine.TIMES),),
                scatter_rank=9,
                as_percent=True,
                is_error=True,
            ),
        ),
        "w = dv / (B (1 + e))",
        "Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007",
        SKIDDING,
        (GYRO, SPEED_Y, HEADING),
        "turns in place and in arcs, and an absolute heading",
        twins=(("gyro_scale", HEADING),),
        wording=Wording.TRACK,
    ),
    Effect(
        "turning_slip",
        (Parameter("turning_slip_ratio", -0.5, 0.9, 0.02),),
        "dv loses D = k q dv, shared as u_r = D a/(a+b), u_l = -D b/(a+b), a = |v_r|^(1-n), b = |v_l|^(1-n), "
        "n = 0.5",
        "Endo et al., IROS 2007, as in Yamauchi et al., (27) written without its singular points; the size "
        "of D is this project's",
        SKIDDING,
        (*MOTION, HEADING),
        "arcs of several radii and turns in place",
    ),
    Effect(
        "turning_slip_power",
        # n from 0, in proportion to the speeds, to 1, alike; Endo et al. fitted one to each ground
        (Parameter("turning_slip_power_ratio", -0.5, 0.5, 0.02),),
        "n = 0.5 + e in turning_slip",
        "Endo et al., IROS 2007, as in Yamauchi et al., (27)",
        (TRACKED,),
        (SPEED_X, ACCEL, CURRENT),
        "arcs of several radii with much turning slip",
        modifies="turning_slip",
    ),
    Effect(
        "track_narrowing",
        # measured: 0.03 to 0.045 s^2/m^2 (Warthog on asphalt and gravel, up to 3.5 m/s and 2.8 rad/s); it
        # goes with 1/mu^2, and would be 2 at mu = 0.1
        (Parameter("track_narrowing_s2pm2", 0.0, 2.0, 0.02),),
        "w grows by x/(1 + x), x = c (u w)^2 / (1 + (w / w0)^2), w0 = 1 rad/s, u and w without it",
        "lateral acceleration moves the centre of rotation ahead by s0, about c' u (turn_side_slip), and the "
        "moment that resists turning falls with (2 s0 / L)^2: Wong, Theory of Ground Vehicles, skid-steering "
        "at high speeds; that it builds up with w, and the bounded form, are this project's",
        SKIDDING,
        (GYRO, SPEED_Y, HEADING),
        "fast arcs, and turns in place",
        wording=Wording.FAST_TURNS,
    ),
    Effect(
        "turn_drag",
        # measured: 0.02 to 0.1 s^2 (Warthog on asphalt and sand), 0.6 to 0.9 s^2 (Husky)
        (Parameter("turn_drag_s2", -0.1, 3.0, 0.005),),
        "u / (1 + c w^2) in place of u, about u (1 - c w^2), and that itself for c < 0; w as simulated, with "
        "the effective track",
        "second-order loss of speed in turns, as in the logs of Baril et al., DRIVE, ICRA 2024; the bounded "
        "form is this project's",
        SKIDDING,
        (SPEED_X,),
        "arcs of several yaw rates",
        wording=Wording.LOSS_IN_TURNS,
    ),
    Effect(
        "force_slip",
        (Parameter("force_slip_ratio", -0.3, 3.0, 0.02, scatter_rank=8),),
        "v = u - |u| c f",
        "linear part of any thrust curve; Wong, Theory of Ground Vehicles",
        EVERY,
        (SPEED_X, SPEED_Y),
        "slopes and accelerations",
        plant=PlantPart.CONTACT,
    ),
    Effect(
        "shear_slip",
        (Parameter("shear_slip_ratio", 0.0, 3.0, 0.02),),
        "f = f_max (1 - K/(s l) (1 - exp(-s l/K))), with K/l = c f_max / 2 so that c is its slip per force "
        "at the start",
        "Janosi and Hanamoto 1961, as integrated along the contact (Yamauchi et al., (17), corrected)",
        WITH_IMU,
        (SPEED_X, SPEED_Y),
        "tractions over half of f_max, of both small and large size",
        plant=PlantPart.CONTACT,
    ),
    Effect(
        "slip_resistance",
        (Parameter("slip_resistance_ratio", 0.0, 5.0, 0.05),),
        "resistance grows by b |s| W",
        "Lyasko, Slip sinkage effect in soil-vehicle mechanics, J. Terramechanics 2010: linear in slip",
        BOTH,
        (CURRENT, SPEED_X),
        "a range of slip",
        plant=PlantPart.CONTACT,
    ),
    Effect(
        "rolling_resistance",
        # without currents it shows by the slip that it takes, as a smaller wheel radius does
        (Parameter("rolling_resistance_ratio", -0.05, 0.5, 0.005, scatter_rank=7),),
        "resistance grows by c W",
        "Wong, Theory of Ground Vehicles",
        BOTH,
        (CURRENT, SPEED_X),
        "several speeds, forward and backward",
        plant=PlantPart.CONTACT,
    ),
    Effect(
        "viscous_drag",
        (Parameter("viscous_drag_nspm", 0.0, 500.0, 3.0),),
        "resistance grows by c v",
        "viscous friction of bearings and gears",
        BOTH,
        (CURRENT, SPEED_X),
        "three speeds",
        plant=PlantPart.CONTACT,
    ),
)

SIDEWAYS: tuple[Effect, ...] = (
    Effect(
        "turn_side_slip",
        # measured: 0.11 to 0.19 s (Husky; Warthog on asphalt, gravel and sand), DRIVE, as turn_drag
        (Parameter("turn_side_slip_s", -0.5, 0.5, 0.005),),
        "v_y = -c v_x w: to the outside of a turn",
        "m (dv_y/dt + w v_x) = -K v_y with c = m/K; the centre of rotation lies c v_x ahead: Mandow et al., "
        "Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007",
        SKIDDING,
        (SPEED_Y,),
        "arcs of several speeds, to both sides",
        wording=Wording.SIDE_SLIP,
    ),
    Effect(
        "side_slip_build_up",
        # with the friction of turn_side_slip its time constant would be c, 0.2 s at the most where measured
        (Parameter("side_slip_build_up_s", 0.0, 1.0, 0.01, one_sided=True),),
        "T dv_y/dt + v_y = -c v_x w",
        "first-order lag of the lateral motion: the inertia in m (dv_y/dt + w v_x) = -K v_y",
        SKIDDING,
        (SPEED_Y,),
        "steps of the yaw rate while driving",
        modifies="turn_side_slip",
    ),
    Effect(
        "scrub",
        (Parameter("scrub_ratio", -0.2, 1.0, 0.005),),
        "resistance to rolling and to turning grow by k q W",
        "scrub of skidding wheels; the form in q as EKF practice has it",
        SKIDDING,
        (CURRENT, TURNING_CURRENT, SPEED_X),
        "turns",
    ),
    Effect(
        "side_hill_slip",
        (Parameter("side_hill_slip_ratio", 0.0, 5.0, 0.05),),
        "v_y = -c ph |v|",
        "Yamauchi et al., (2), with the sign that gravity sets",
        WITH_IMU,
        (SPEED_Y,),
        "both signs of roll",
        plant=PlantPart.CONTACT,
    ),
)
