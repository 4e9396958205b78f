// Scalar products of square blocks of BLOCK x BLOCK texels; the kernel sum.glsl adds the blocks.
//
//     total(block) = sum of first . second over the texels of the block, row by row
//
// Inputs:  first, second  any units; pairs
// Outputs: total          product of the units; one texel for each block
// Border rule: a block that extends beyond the image adds only its texels inside the image.

void kernel(ivec2 block)
{
    ivec2 begin = block * BLOCK;
    ivec2 end = min(begin + BLOCK, textureSize(first, 0));
    total = 0.0;
    for (int row = begin.y; row < end.y; ++row) {
        float along = 0.0;
        for (int col = begin.x; col < end.x; ++col) {
            ivec2 at = ivec2(col, row);
            along += dot(texelFetch(first, at, 0), texelFetch(second, at, 0));
        }
        total += along;
    }
}
