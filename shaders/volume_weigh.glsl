// A scalar product, and a largest absolute value.
//
//     total = one . other,    most = max |one|
//
// Inputs:  one, other  any units
// Outputs: shares      their product, and the unit of the first
// Border rule: none needed, a site reads its own values only.

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        float value = one[k].at[at];
        total += value * other[k].at[at];
        most = max(most, abs(value));
    }
}
