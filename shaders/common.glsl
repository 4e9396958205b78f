// What every kernel shares; put before the kernel's own text.
//
// A site is addressed the way textures are: site.x counts columns, site.y counts rows. Values of
// two components are in (row, col) order, as the arrays of the package are. All lengths are in
// pixels of the finest level, all values float32.
//
// Border rule: none of its own. A kernel clamps every coordinate it reads with `clamped`, since a
// read outside of a texture is undefined, and asks `in_image` where outside must count as void.

// The lines, from t to u (figure 2); s lies on the other side. Order and direction as in
// `napari_hmrf.priors.LINES`.
const ivec2 VERTICAL = ivec2(0, 1);
const ivec2 HORIZONTAL = ivec2(1, 0);
const ivec2 DIAGONAL = ivec2(1, 1);
const ivec2 ANTIDIAGONAL = ivec2(-1, 1);

/// The nearest site that lies in an image of this size.
ivec2 clamped(ivec2 site, ivec2 size)
{
    return clamp(site, ivec2(0), size - 1);
}

/// Whether a site lies in an image of this size.
bool in_image(ivec2 site, ivec2 size)
{
    return all(greaterThanEqual(site, ivec2(0))) && all(lessThan(site, size));
}
