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

void kernel(ivec2 pair)
{
#if SIGNED
    float way = texelFetch(above, ivec2(0), 0).x;
#else
    float way = ratio();
#endif
    ivec2 at = clamped(pair, textureSize(found, 0));
    further = texelFetch(found, at, 0) + way * texelFetch(direction, at, 0);
    left = texelFetch(rest, at, 0) - way * texelFetch(image, at, 0);
    share = dot(left, left);
}
