// Vertex shader for all fragment shaders: one triangle that covers the whole viewport, at depth
// 0.5. A mask is a depth texture with 1 in tissue and 0 in void. With a mask, a kernel runs only
// where the mask is deeper than the triangle.
//
// Border rule: the rasterizer clips the triangle, which is larger than the viewport.

void main()
{
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 0.0, 1.0);
}
