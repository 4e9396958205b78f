// Stiffness ratios of the four cliques with a site in the middle.
//
//     straight = (m_t/m_s, m_t/m_u) of the vertical line and of the horizontal line
//     diagonal = (m_t/m_s, m_t/m_u) of the diagonal and of the antidiagonal
//
// Inputs:  stiffness  (m, 1/m), any unit, both 0 in void; pairs
// Outputs: straight, diagonal  no unit; both ratios of a clique are 0 if it does not exist
// Border rule: sites outside the image are void, so a clique that extends beyond the image does not
// exist.
//
// The ratios of a level are computed once for all sweeps.

/// Return 1/m of a site; 0 in void and outside the image.
float inverse_stiffness(ivec2 site)
{
    ivec2 size = sites_of(stiffness);
    float inverse = value_at(stiffness, clamped(site, size)).y;
    return in_image(site, size) ? inverse : 0.0;
}

vec2 ratios_of(ivec2 site, ivec2 line, float m)
{
    vec2 inverse = vec2(inverse_stiffness(site - line), inverse_stiffness(site + line));
    bool exists = inverse.x * m * inverse.y > 0.0;
    return exists ? m * inverse : vec2(0.0);
}

void kernel(ivec2 site)
{
    float m = value_at(stiffness, site).x;
    straight = vec4(ratios_of(site, VERTICAL, m), ratios_of(site, HORIZONTAL, m));
    diagonal = vec4(ratios_of(site, DIAGONAL, m), ratios_of(site, ANTIDIAGONAL, m));
}
