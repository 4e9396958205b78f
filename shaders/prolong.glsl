// Linear interpolation of displacement to the next finer level (line 3).
//
//     fine(site) = sum of w coarse(k) / sum of w
//
// over the four nearest coarse sites k, excluding sites in void. The weight w is the product of 3/4
// or 1/4 for the row and 3/4 or 1/4 for the column.
//
// Inputs:  coarse            d, pixels; pairs
//          coarse_stiffness  (m, 1/m), any unit, 0 in void; pairs
//          stiffness         (m, 1/m) of the finer level, any unit; pairs
// Outputs: fine              d, pixels; 0 in void and where all coarse neighbours are void; pairs
// Border rule: coarse border sites are repeated outside the image. The result is the same as with
// void outside, because the repetition multiplies all remaining weights by the same factor.

vec2 interpolated(ivec2 site)
{
    ivec2 size = sites_of(coarse);
    ivec2 near = clamped(site / 2, size);
    ivec2 far = clamped(near + 2 * (site % 2) - 1, size);
    float total = 0.0;
    vec2 sum = vec2(0.0);
    for (int k = 0; k < 4; ++k) {
        ivec2 from = ivec2(k % 2 == 0 ? near.x : far.x, k < 2 ? near.y : far.y);
        float weight = (k % 2 == 0 ? 0.75 : 0.25) * (k < 2 ? 0.75 : 0.25);
        weight = value_at(coarse_stiffness, from).x > 0.0 ? weight : 0.0;
        total += weight;
        sum += weight * value_at(coarse, from);
    }
    bool tissue = value_at(stiffness, site).x > 0.0;
    return tissue && total > 0.0 ? sum / max(total, 0.0625) : vec2(0.0);
}

void kernel(ivec2 pair)
{
    ivec2 site = first_of(pair);
    fine = vec4(interpolated(site), interpolated(site + HORIZONTAL));
}
