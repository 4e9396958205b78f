// Scalars on the device: one buffer, which volume_total.glsl writes.
//
//     ratio = scalars[above] / scalars[below]; 0 unless both are positive
//
// Inputs:  scalars       buffer of all scalars, any units
//          above, below  indices of the numerator and the denominator
// Border rule: none needed, because no sites are read.

uniform int above;
uniform int below;

/// Return the ratio of the two scalars.
float ratio()
{
    float first_of = scalars.at[above];
    float second_of = scalars.at[below];
    bool positive = first_of > 0.0 && second_of > 0.0;
    return positive ? first_of / (positive ? second_of : 1.0) : 0.0;
}
