// Diagonal of the stiffness matrix.
//
//     diagonal_k = sum over 8 elements of share lambda q_k^2 + 16 mu (q_k^2 + sum of q^2) / 9
//
// Inputs:  lame      mu, and lambda if PARAMETERS is 2 (hexahedra.glsl)
//          shape     q along the plane, row and column axes
//          share     lambda / mu if PARAMETERS is 1, else 1
// Outputs: diagonal  stiffness, for each component; relative to the stiffest tissue
// Border rule: elements outside the grid are void.

uniform float shape[3];
uniform float share;

/// Return the sum of a parameter over the eight elements around a site.
float around(int parameter, int at)
{
    int next = pitch();
    int above = at - stride();
    float one = lame[parameter].at[above - next] + lame[parameter].at[above];
    one += lame[parameter].at[at - next] + lame[parameter].at[at];
    float other = lame[parameter].at[above - next - 1] + lame[parameter].at[above - 1];
    other += lame[parameter].at[at - next - 1] + lame[parameter].at[at - 1];
    return one + other;
}

void kernel(int at)
{
    float slide = around(0, at);
    float stretch = share * around(PARAMETERS - 1, at);
    float all = shape[0] * shape[0] + shape[1] * shape[1] + shape[2] * shape[2];
    for (int k = 0; k < 3; ++k) {
        float own = shape[k] * shape[k];
        diagonal[k].at[at] = stretch * own + slide * (16.0 / 9.0) * (own + all);
    }
}
