// Quotient of two products of scalars, which may have any sign.
//
//     value = (above / below) (above_by / below_by); 0 if a denominator is 0
//
// Inputs:  above, above_by, below, below_by  scalars (scalars.glsl), any units
// Outputs: value  scalar, unit of the quotient
// Border rule: none needed, because there is only one texel.

/// Return a / b; 0 if b is 0.
float part(sampler2D a, sampler2D b)
{
    float under = texelFetch(b, ivec2(0), 0).x;
    bool there = under != 0.0;
    return there ? texelFetch(a, ivec2(0), 0).x / (there ? under : 1.0) : 0.0;
}

void kernel(ivec2 one)
{
    value = part(above, below) * part(above_by, below_by);
}
