// A coarser level's springs, and the inverse of its diagonal with them.
//
//     pins = min(pins, MOST_PINS),    springs = strength pins diagonal
//
// Inputs:  inverse   the diagonal
//          pins      how much of what the finer level holds counts at a site
//          most_pins, strength  no unit (`solver.coarse_levels`)
// Outputs: inverse   1 / (diagonal + springs); 0 where there are no elements
//          pins      what counts for the next level
//          springs   W, one component after the other
//          shares    the largest inverse: above 0 where something moves
// Border rule: none needed, a site reads its own values only.

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
