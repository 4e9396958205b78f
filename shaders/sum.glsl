// Totals of square blocks of BLOCK x BLOCK texels; the host adds the blocks up in double precision.
//
//     total(block) = sum of share over the block's texels, row by row
//
// Inputs:  share  any unit
// Outputs: total  the same unit; one texel per block
// Border rule: a block that reaches beyond the image sums the texels it has there.

void kernel(ivec2 block)
{
    ivec2 first = block * BLOCK;
    ivec2 last = min(first + BLOCK, textureSize(share, 0));
    total = 0.0;
    for (int row = first.y; row < last.y; ++row) {
        float along = 0.0;
        for (int col = first.x; col < last.x; ++col) {
            along += texelFetch(share, ivec2(col, row), 0).x;
        }
        total += along;
    }
}
