// Springs of a coarser level, and the reciprocal of its diagonal including the springs.
//
//     pins = min(pins, most_pins),    springs = strength pins diagonal,
//     inverse = 1 / (diagonal + springs); 0 where there are no elements
//
// Inputs:  inverse   diagonal, stiffness
//          pins      restricted count of prescribed components of the finer level, no unit
//          most_pins, strength  no unit (`solver.coarse_levels`)
// Outputs: inverse   reciprocal, 1 / stiffness
//          pins      count of prescribed components for the next level, no unit
//          springs   diagonal matrix W, stiffness; components in consecutive blocks
//          shares    largest reciprocal in each group: positive if a site in the group is free
// Border rule: none needed, because a site reads only its own values.

uniform float most_pins;
uniform float strength;

void kernel(int at)
{
    int size = (depth + 4) * stride();
    for (int k = 0; k < 3; ++k) {
        float diagonal = inverse[k].at[at];
        float count = min(pins[k].at[at], most_pins);
        float spring = strength * count * diagonal;
        float whole = diagonal + spring;
        float value = whole > 0.0 ? 1.0 / whole : 0.0;
        pins[k].at[at] = count;
        springs.at[k * size + at] = spring;
        inverse[k].at[at] = value;
        most = max(most, value);
    }
}
