// Scalar products of square blocks of BLOCK x BLOCK texels; the kernel sum adds the blocks up.
//
//     total(block) = sum of first . second over the block's texels, row by row
//
// Inputs:  first, second  any units; pairs
// Outputs: total          their product; one texel per block
// Border rule: a block that reaches beyond the image sums the texels it has there.

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
