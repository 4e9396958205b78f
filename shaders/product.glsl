// Scalar product of two vectors; the kernel sum.glsl adds the contributions.
//
//     share = first . second
//
// Inputs:  first, second  any units; pairs
// Outputs: share          contribution of each pair, product of the units
// Border rule: none needed, because a pair reads only its own texel.

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(first, 0));
    share = dot(texelFetch(first, at, 0), texelFetch(second, at, 0));
}
