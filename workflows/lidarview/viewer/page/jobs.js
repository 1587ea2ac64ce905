// The job list: the progress, a table of some jobs, the points of one job, and charts.
import { ask } from "./ask.js";
import { element, themeButton } from "./controls.js";
import { follow, meter, replace, slots, stop } from "./run.js";

const NEWS_MS = 1000;
const SETTLED_MS = 1500; // time in which a job's viewer draws after its page has loaded

const $ = (id) => document.getElementById(id);
const whole = (value) => Math.round(value).toLocaleString("en");

// 12,345 with up to six digits, then 1.23 M
function short(value) {
  for (const [size, letter] of [[1e12, "T"], [1e9, "G"], [1e6, "M"]]) {
    if (value >= size) return `${(value / size).toPrecision(3)} ${letter}`;
  }
  return whole(value);
}

const inSeconds = (value) => value === null ? "–" : `${value >= 100 ? whole(value) : value.toPrecision(2)} s`;

// -- the run -----------------------------------------------------------------------------

function showRun(told) {
  if (told.still && shown === null) $("cloud").querySelector("p").textContent = "Loading the points of a job …";
  document.title = `${told.over ? "" : `${Math.floor((100 * (told.done + told.failed)) / told.count)}% `}${told.title} - lidarpool`;
  $("title").textContent = told.title;
  $("state").textContent = told.state;
  $("count").replaceChildren(element("b", { textContent: whole(told.done) }), ` of ${whole(told.count)} jobs done`);
  $("bar").replaceChildren(...[["done", told.done], ["failed", told.failed], ["busy", told.busy]].map(
    ([className, jobs]) => element("i", { className, style: { width: `${(100 * jobs) / told.count}%` } }),
  ));
  const entries = [
    ["failed", whole(told.failed), "failed", told.failed > 0], ["running", told.over ? "" : whole(told.busy), "busy"],
    ["rate", told.rate], ["left", told.left], ["time", told.time], ["points", short(told.points)], ["rays", short(told.rays)],
  ];
  $("figures").replaceChildren(...entries.filter(([, value]) => value !== "").map(([name, value, className, bad]) => {
    const mark = className ? [element("i", { className })] : [];
    return element("div", { className: bad ? "bad" : "" }, element("dt", {}, ...mark, name), element("dd", { textContent: value }));
  }));
  $("slots").replaceChildren(...told.slots.map(slots));
}

// -- the table ---------------------------------------------------------------------------

// The name of a job links to its page if its points can be shown.
function nameOf(job) {
  if (!job.opens) return cell(job.name);
  return element("td", {}, element("a", { href: `job/${job.number}/`, target: "_blank", title: "Open the point cloud of this job", textContent: job.name }));
}
const cell = (text, className = "") => element("td", { textContent: text, className });

// Paths may wrap after dots.
const broken = (name) => name.split(/(?<=\.)/).flatMap((part, k) => (k ? [element("wbr"), part] : [part]));

function group(title, remark, width, rows) {
  if (!rows.length) return [];
  const head = element("th", { className: "group", colSpan: width }, `${title} `, element("small", { textContent: remark }));
  return [element("tbody", {}, element("tr", {}, head), ...rows)];
}

function showJobs(told) {
  const width = told.names.length + 4;
  const line = (job, state, points, seconds) => element(
    "tr", {}, nameOf(job), state, cell(points), cell(seconds), ...job.values.map((value) => cell(value)),
  );
  const underWay = told.under_way.map((job) => {
    const state = cell(job.writing ? "writing" : "casting", "text");
    state.append(meter(job.writing ? 1 : job.stored / Math.max(job.scans, 1)));
    return line(job, state, whole(job.points), inSeconds(job.seconds));
  });
  const failed = told.failures.flatMap((job, k) => {
    const own = line(job, cell("failed", "text"), "", "");
    if (told.failures[k + 1]?.error === job.error) return [own]; // a reason is shown once below all jobs that have it
    const reason = element("td", { className: "reason", colSpan: width }, element("span", { textContent: job.error }));
    return [own, element("tr", {}, reason)];
  });
  const ended = told.ended.map((job) => line(job, cell("done", "text"), whole(job.points), inSeconds(job.seconds)));
  const last = (jobs, listed) => (jobs > listed ? `the ${told.still ? "first" : "last"} ${whole(listed)} of ${whole(jobs)}` : whole(jobs));
  const bodies = [
    ...group("Running", told.busy > underWay.length ? `first ${underWay.length} of ${whole(told.busy)}` : whole(told.busy), width, underWay),
    ...group("Failed", last(told.failed, told.failures.length), width, failed),
    ...group("Done", last(told.done, told.ended.length), width, ended),
  ];
  const heads = [["job"], ["state", "text"], ["points"], ["casting"], ...told.names.map((name) => [name])];
  const head = element("thead", {}, element("tr", {}, ...heads.map(([name, className = ""]) => element("th", { className }, ...broken(name)))));
  replace($("jobs"), element("table", {}, head, ...bodies));
}

// -- points of a job ---------------------------------------------------------------------

let shown = null, follows = true, isLoading = false;
let isStill = false; // for a data set, whose jobs are all complete

// The viewer of a job replaces the previous one once it has drawn.
function showCloud(newest) {
  if (!newest || isLoading || newest[0] === shown || (shown !== null && !follows)) return;
  const [number, name] = newest;
  const before = [...$("frames").children];
  const frame = element("iframe", { src: `job/${number}/?plain`, title: `points of job ${name}`, className: "coming" });
  isLoading = true;
  shown = number;
  frame.onload = () => setTimeout(() => {
    frame.className = "";
    isLoading = false;
    setTimeout(() => before.forEach((old) => old.remove()), 400);
    const box = element("input", { type: "checkbox", checked: follows, onchange: () => { follows = box.checked; } });
    $("shown").replaceChildren(
      element("span", {}, "Points of ", element("b", { textContent: `job ${name}` })),
      element("a", { href: `job/${number}/`, target: "_blank", textContent: "open in the viewer" }),
      ...(isStill ? [] : [element("label", {}, box, "switch to newer jobs automatically")]),
    );
  }, SETTLED_MS);
  $("frames").append(frame);
}

// -- news --------------------------------------------------------------------------------

// The content policy refuses inline styles in HTML, but not styles that a script sets.
function showCharts(svg) {
  $("charts").innerHTML = svg.replaceAll(' style="', ' data-style="');
  for (const styled of $("charts").querySelectorAll("[data-style]")) {
    styled.style.cssText = styled.dataset.style;
    delete styled.dataset.style;
  }
}

let charts = 0;
async function show(told) {
  isStill = Boolean(told.still);
  showRun(told);
  if (!isStill || !$("jobs").querySelector("tbody")) showJobs(told);
  showCloud(told.newest);
  if (told.charts !== charts) {
    charts = told.charts;
    showCharts((await ask("charts")).svg);
  }
}

$("buttons").append(themeButton(), stop);
follow("jobs", () => ({ newest: follows && !document.hidden ? 1 : undefined }), NEWS_MS, show).catch((error) => {
  console.warn(error);
  $("slots").replaceChildren(); // the run has ended
  $("state").textContent = error.message;
  $("state").className = "bad";
});
