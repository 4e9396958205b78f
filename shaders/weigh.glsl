// Largest value of a vector, and its scalar product with another; weighed.glsl combines the
// contributions.
//
//     peak = max |first|,    share = first . second
//
// Inputs:  first, second  any units; pairs
// Outputs: share          contribution of each pair to the product, product of the units
//          peak           largest absolute value of each pair, unit of `first`
// Border rule: none needed, because a pair reads only its own texel.

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(first, 0));
    vec4 one = texelFetch(first, at, 0);
    share = dot(one, texelFetch(second, at, 0));
    vec4 size = abs(one);
    peak = max(max(size.x, size.y), max(size.z, size.w));
}
