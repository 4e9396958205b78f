// The vertex shader of kernels that only tissue needs: a rectangle for each band of rows, from its
// first column of tissue to its last, drawn as strips of two triangles, one instance per band.
//
// Inputs:  bands     (begin, end) of each band's tissue, columns, in a texture of one column
//          grid      (cols, rows) of sites
//          band_rows rows of a band; the last may be shorter
// Border rule: sites outside the rectangles are not run; there is no tissue there, their outputs
// hold 0 from before and keep it.

uniform sampler2D bands;
uniform ivec2 grid;
uniform int band_rows;

void main()
{
    vec2 span = texelFetch(bands, ivec2(0, gl_InstanceID), 0).xy;
    float col = gl_VertexID % 2 == 0 ? span.x : span.y;
    int row = min((gl_InstanceID + gl_VertexID / 2) * band_rows, grid.y);
    gl_Position = vec4(2.0 * vec2(col, float(row)) / vec2(grid) - 1.0, 0.0, 1.0);
}
