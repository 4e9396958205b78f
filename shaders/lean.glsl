// Next search direction of stabilized biconjugate gradients.
//
//     leaned = rest + share (direction - stride image)
//
// Inputs:  rest, direction, image  pixels; pairs
//          share, stride           scalars (scalars.glsl)
// Outputs: leaned                  pixels; pairs
// Border rule: none needed, because a pair reads only its own texel.

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(direction, 0));
    vec4 ahead = texelFetch(direction, at, 0);
    ahead -= texelFetch(stride, ivec2(0), 0).x * texelFetch(image, at, 0);
    leaned = texelFetch(rest, at, 0) + texelFetch(share, ivec2(0), 0).x * ahead;
}
