// Next search direction of conjugate gradients.
//
//     turned = steepest + above / below direction
//
// Inputs:  steepest, direction  pixels; pairs
//          above, below         scalars (scalars.glsl)
// Outputs: turned               pixels; pairs
// Border rule: none needed, because a pair reads only its own texel.

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(direction, 0));
    turned = texelFetch(steepest, at, 0) + ratio() * texelFetch(direction, at, 0);
}
