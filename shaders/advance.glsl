// Step of an iteration along a search direction.
//
//     length = above / below, or `above` if SIGNED
//     further = found + length direction,    left = rest - length image,    share = left . left
//
// Inputs:  found, direction  pixels; pairs
//          rest, image       pixels times stiffness; pairs
//          above, below      scalars (scalars.glsl)
// Outputs: further           pixels; pairs
//          left              pixels times stiffness; pairs
//          share             contribution of each pair to left . left
// Border rule: none needed, because a pair reads only its own texel.

float way;

/// Prepare the first pair of an invocation. The stage calls this function once.
void enter(ivec2 pair)
{
#if SIGNED
    way = texelFetch(above, ivec2(0), 0).x;
#else
    way = ratio();
#endif
}

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(found, 0));
    further = texelFetch(found, at, 0) + way * texelFetch(direction, at, 0);
    left = texelFetch(rest, at, 0) - way * texelFetch(image, at, 0);
    share = dot(left, left);
}
