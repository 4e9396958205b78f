// Displacement one level down, by linear interpolation (line 3).
//
//     fine(site) = sum of w coarse(k) / sum of w over the four nearest coarse sites k in tissue,
//                  w = (3/4 or 1/4 for the row) (3/4 or 1/4 for the column)
//
// Inputs:  coarse            d, pixels
//          coarse_stiffness  (m, 1/m), any unit, 0 in void
//          stiffness         (m, 1/m) of the finer level
// Outputs: fine              d, pixels; 0 in void, and where no coarse neighbour is tissue
// Border rule: the coarse border site is repeated outwards.

void kernel(ivec2 site)
{
    ivec2 size = textureSize(coarse, 0);
    ivec2 near = clamped(site / 2, size);
    ivec2 far = clamped(near + 2 * (site % 2) - 1, size);
    float total = 0.0;
    vec2 sum = vec2(0.0);
    for (int k = 0; k < 4; ++k) {
        ivec2 from = ivec2(k % 2 == 0 ? near.x : far.x, k < 2 ? near.y : far.y);
        float weight = (k % 2 == 0 ? 0.75 : 0.25) * (k < 2 ? 0.75 : 0.25);
        weight = texelFetch(coarse_stiffness, from, 0).x > 0.0 ? weight : 0.0;
        total += weight;
        sum += weight * texelFetch(coarse, from, 0).xy;
    }
    bool tissue = texelFetch(stiffness, site, 0).x > 0.0;
    fine = tissue && total > 0.0 ? sum / max(total, 0.0625) : vec2(0.0);
}
