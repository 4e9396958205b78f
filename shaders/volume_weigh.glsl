// Scalar product of two vectors, and largest absolute value in the first vector.
//
//     total = one . other,    most = max |one|
//
// Inputs:  one, other  any units
// Outputs: shares      (total, most) of each group: product of the units, and unit of `one`
// Border rule: none needed, because a site reads only its own values.

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        float value = one[k].at[at];
        total += value * other[k].at[at];
        most = max(most, abs(value));
    }
}
