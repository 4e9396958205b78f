// A step of conjugate gradients along a direction.
//
//     length = above / below,    further = found + length direction,    left = rest - length image
//     share  = left . left
//
// Inputs:  found, direction  pixels; pairs
//          rest, image       pixels times stiffness; pairs
//          above, below      scalars (scalars.glsl)
// Outputs: further           pixels; pairs
//          left              pixels times stiffness; pairs
//          share             a pair's part of the square
// Border rule: none needed, a pair reads its own texel only.

void kernel(ivec2 pair)
{
    float way = ratio();
    ivec2 at = clamped(pair, textureSize(found, 0));
    further = texelFetch(found, at, 0) + way * texelFetch(direction, at, 0);
    left = texelFetch(rest, at, 0) - way * texelFetch(image, at, 0);
    share = dot(left, left);
}
