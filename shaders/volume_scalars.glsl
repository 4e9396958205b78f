// Numbers that stay on the device: one buffer of them, written by volume_total and read by others.
//
// A kernel that takes one takes the ratio of two.
//
// Inputs:  scalars       the numbers
//          above, below  which of them
// Border rule: none needed.

uniform int above;
uniform int below;

/// The first over the second; 0 unless both are positive.
float ratio()
{
    float first_of = scalars.at[above];
    float second_of = scalars.at[below];
    bool positive = first_of > 0.0 && second_of > 0.0;
    return positive ? first_of / (positive ? second_of : 1.0) : 0.0;
}
