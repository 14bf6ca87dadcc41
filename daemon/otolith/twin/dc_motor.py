"""The permanent-magnet DC motor of paper.txt section 4.1, in continuous time (Eq. 4, and Eq. 12 for the signs).

States i (A) and omega (rad/s); inputs V_a (V), a command held for a record, and T_load (N·m), measured.
"""

from otolith.twin.model import Input, Output, Parameter, Twin

DC_MOTOR = Twin(
    name="dc_motor",
    title="permanent-magnet DC motor",
    source="An Interpretable Digital Twin for Self-Aware Industrial Machines (2023), Eq. 4, 11, 12 and Table 3",
    parameters=(
        Parameter("R_a", "ohm", 6.5, 3.0, 12.0, "armature resistance"),
        Parameter("L_a", "H", 0.673, 0.2, 2.0, "armature inductance"),
        Parameter("J", "kg*m^2", 0.001171, 0.0003, 0.005, "moment of inertia of the rotor"),
        Parameter("K_e", "V*s/rad", 0.038, 0.01, 0.15, "electromotive force constant"),
        Parameter("K_t", "N*m/A", 0.038, 0.01, 0.15, "torque constant"),
        Parameter("D", "N*m*s/rad", 0.00143, 0.0, 0.01, "viscous damping coefficient of the rotor"),
    ),
    inputs=(
        Input("V_a", "V", "armature voltage", "zoh"),
        Input("T_load", "N*m", "load torque", "foh"),
    ),
    outputs=(
        Output("i", "A", "armature current", 0.005),
        Output("omega", "rad/s", "rotor speed", 0.02),
    ),
    states=("i", "omega"),
    equations=("der(i) = (V_a - R_a*i - K_e*omega) / L_a", "der(omega) = (K_t*i - T_load - D*omega) / J"),
    kernel="otolith.twin.dc_motor_kernel",
)
