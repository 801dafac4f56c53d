// A crane hook, 0.2 m tall, in metres; the up axis is Z and the load pulls along -Z.
//
// Makes hook.msh (second order, MSH 2.2 binary) with Gmsh 4.11 or later:
//
//     gmsh -3 -bin -format msh22 hook.geo -o hook.msh
//
// A round bar runs down the shank (axis x = y = 0), bends to the side, and sweeps the bowl, whose centre lies below
// the shank, so that the load's line goes through both. Its tip is a hemisphere.
//
// Physical groups: volume "body"; surface "fixed", the top of the shank; surface "pull", the inner saddle of the bowl,
// where a sling would lie: its outward normal points up, its load down.

SetFactory("OpenCASCADE");

r  = 0.012;                     // radius of the bar
Rb = 0.035;                     // radius of the bowl's centre line
Rs = 0.020;                     // radius of the bend below the shank
top = 0.2;
zc = Rb + r;                    // height of the bowl's centre: the lowest point lies at z = 0
alpha = Acos(Rs / (Rs + Rb));   // angle of the bend: bend and bowl meet with one tangent
zs = zc + (Rs + Rb) * Sin(alpha);   // where the shank ends
saddle = 35 * Pi / 180;         // half the angle of the patch, seen from the bowl's centre
tip = 25 * Pi / 180;            // how far the tip rises above the bowl's centre

// Section at the top, four arcs; the first faces +x, which becomes the inside of the bowl (s4[2] is its strip).
Point(1) = {0, 0, top};
For k In {0:3}
  a = (2 * k - 1) * Pi / 4;
  Point(2 + k) = {r * Cos(a), r * Sin(a), top};
EndFor
For k In {0:3}
  Circle(1 + k) = {2 + k, 1, 2 + (k + 1) % 4};
EndFor
Curve Loop(1) = {1:4};
Plane Surface(1) = {1};

// Shank, bend towards -x, then the bowl in three pieces: before, at and after the saddle.
s1[] = Extrude {0, 0, zs - top} { Surface{1}; };
s2[] = Extrude {{0, 1, 0}, {-Rs, 0, zs}, alpha} { Surface{s1[0]}; };
bowl = Pi / 2 + alpha;          // from the end of the bend down to the lowest point
s3[] = Extrude {{0, -1, 0}, {0, 0, zc}, bowl - saddle} { Surface{s2[0]}; };
s4[] = Extrude {{0, -1, 0}, {0, 0, zc}, 2 * saddle} { Surface{s3[0]}; };
s5[] = Extrude {{0, -1, 0}, {0, 0, zc}, Pi / 2 + tip - saddle} { Surface{s4[0]}; };
// s5[0] is the section at the tip; close it with a half ball.
v = newv;
Sphere(v) = {0, 0, 0, r, 0, Pi / 2, 2 * Pi};
Rotate {{0, 1, 0}, {0, 0, 0}, -tip} { Volume{v}; }
Translate {Rb * Cos(tip), 0, zc + Rb * Sin(tip)} { Volume{v}; }
Coherence;

Physical Volume("body") = Volume{:};
eps = 1e-4;
fixed() = Surface In BoundingBox {-r - eps, -r - eps, top - eps, r + eps, r + eps, top + eps};
Physical Surface("fixed") = {fixed()};
Physical Surface("pull") = {s4[2]};

Mesh.MeshSizeMin = 0.0065;
Mesh.MeshSizeMax = 0.0065;
Mesh.Algorithm3D = 10;
Mesh.ElementOrder = 2;
Mesh.HighOrderOptimize = 1;
Mesh.Optimize = 1;
Mesh.OptimizeNetgen = 1;
