// Sums and largest values of square blocks of BLOCK x BLOCK texels, after weigh.glsl.
//
//     total(block) = sum of share over the texels of the block, row by row
//     most(block) = max of peak over the texels of the block; at least 0
//
// Inputs:  share, peak  any units; one value in each texel
// Outputs: total, most  units of `share` and `peak`; one texel for each block
// Border rule: a block that extends beyond the image uses only its texels inside the image.

void kernel(ivec2 block)
{
    ivec2 begin = block * BLOCK;
    ivec2 end = min(begin + BLOCK, textureSize(share, 0));
    total = 0.0;
    most = 0.0;
    for (int row = begin.y; row < end.y; ++row) {
        float along = 0.0;
        for (int col = begin.x; col < end.x; ++col) {
            along += texelFetch(share, ivec2(col, row), 0).x;
            most = max(most, texelFetch(peak, ivec2(col, row), 0).x);
        }
        total += along;
    }
}
