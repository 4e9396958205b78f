// Next search direction of conjugate gradients.
//
//     turned = steepest + above / below direction
//
// Inputs:  steepest, direction  pixels; pairs
//          above, below         scalars (scalars.glsl)
// Outputs: turned               pixels; pairs
// Border rule: none needed, because a pair reads only its own texel.

float part;

/// Prepare the first pair of an invocation. The stage calls this function once.
void enter(ivec2 pair)
{
    part = ratio();
}

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(direction, 0));
    turned = texelFetch(steepest, at, 0) + part * texelFetch(direction, at, 0);
}
